"""The surroundings of the process: log, service manager, folders, locks, threads, machine."""
