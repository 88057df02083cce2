"""The live page for phones and desktops, and the flights in the folder of captures.

``content`` makes the page's data from CAN frames. ``server`` sends them to browsers. ``flights``
lists the captures and has reports made by a child process.
"""
