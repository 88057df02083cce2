"""Documentation generated from DBC and EDS in use, sources, error bits and states. ``facts`` collects, the rest renders."""
