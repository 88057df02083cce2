"""From configuration, files and captures to the objects that run."""
