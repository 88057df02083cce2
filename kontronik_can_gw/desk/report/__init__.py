"""A recorded flight as an HTML page: ``flight`` and ``esc`` turn rows into numbers, events and points, which ``page`` renders."""
