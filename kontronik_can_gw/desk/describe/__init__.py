"""Tables of everything a gateway sends and its meaning, rendered as Markdown.

They cover messages and objects of the DBC and EDS in use, values, errors and states.
"""
