"""Access rules, certificates, provisioning of a site, limits and audit of commands."""
