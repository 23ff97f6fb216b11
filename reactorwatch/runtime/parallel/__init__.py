"""Functions over many inputs: in this process, in others of this machine, or on a Dask cluster."""
