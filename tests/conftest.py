"""python-can comes first, and asammdf with it: the gateway's own code keeps that out, for the rest of the process.

On a vcan neither is wanted so early.
"""

import gc
import os

if not os.environ.get("KCG_VCAN"):
    import can  # noqa: F401
    from hypothesis import HealthCheck, settings

    # the same examples in every run, and none is judged by how long it took
    settings.register_profile(
        "suite", deadline=None, derandomize=True, suppress_health_check=[HealthCheck.too_slow]
    )
    settings.load_profile("suite")


def pytest_collection_finish() -> None:
    """What was imported stays: a collection that walks through pandas and its like holds a gateway in this process up for long."""
    gc.collect()
    gc.freeze()
