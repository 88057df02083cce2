"""What other libraries load of each other must not depend on the test that happens to be first.

canmatrix finds all its formats only if it comes before python-can, which finds asammdf only if the gateway's own code, which keeps that out,
comes later. On a vcan none of them is wanted.
"""

import os

if not os.environ.get("KCG_VCAN"):
    import canmatrix.formats  # type: ignore[import-untyped]  # noqa: F401, I001
    import can  # noqa: F401
