"""python-can comes first, and asammdf with it: the gateway's own code keeps that out, for the rest of the process.

On a vcan neither is wanted so early.
"""

import os

if not os.environ.get("KCG_VCAN"):
    import can  # noqa: F401
