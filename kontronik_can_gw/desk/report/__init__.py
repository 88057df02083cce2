"""A recorded flight as an HTML page: ``flight`` and ``esc`` turn rows into numbers and events; ``page`` and ``summary`` render them."""
