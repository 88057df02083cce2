"""A recorded flight as an HTML page: ``flight`` and ``esc`` turn rows into numbers, events and points; ``page`` and ``summary`` render them."""
