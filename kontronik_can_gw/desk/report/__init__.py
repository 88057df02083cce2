"""A recorded flight as one page for people. analysis (with decimate, ledger, fit) makes a flight of rows; page shows it."""
