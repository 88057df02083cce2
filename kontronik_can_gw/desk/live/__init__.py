"""A page with the ESCs' values for phones and desktops, and the list of flights.

``content`` makes the page's data from CAN frames. ``server`` sends them to browsers. ``flights``
lists the captures and has reports made by a child process.
"""
