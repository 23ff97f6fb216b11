"""The study of the diagnosis: records with something hidden in them, class by class."""
