"""A recorded flight as an HTML page. analysis (with decimate, ledger, fit) turns rows into a flight; page renders it."""
