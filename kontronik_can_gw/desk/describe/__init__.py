"""Documentation made from the sources of truth: DBC and EDS in use, sources, error bits, states. ``facts`` gathers, the rest renders."""
