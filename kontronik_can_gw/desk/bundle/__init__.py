"""The support bundle of `doctor --bundle`: a zip file without passwords and keys.

``secrets`` recognises them in any text, ``files`` in configurations, DBC and EDS files, and
``captures`` in captures. ``parts`` collects the content, and ``archive`` writes the file.
"""
