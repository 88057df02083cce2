"""Makes an HTML page of a recorded flight.

``flight`` and ``esc`` turn rows into numbers, events and points, which ``page`` renders.
"""
