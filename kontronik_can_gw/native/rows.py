"""The rows of the core's tables, and what it counts, by their names in core.h."""

from kontronik_can_gw.native.header import NotInCore as NotInCore
from kontronik_can_gw.native.header import enumeration, structure

Piece, Pair = structure("kcg_piece"), structure("kcg_pair")
Signal, Message = structure("kcg_signal"), structure("kcg_message")
Settings = structure("kcg_settings")
COUNTS = enumeration("KCG_N_BYTES", "KCG_N_")
"""Of kcg_esc.count, in its order; the last ones, from ``link_state`` on, are states and sums."""
GATEWAY = enumeration("KCG_ESCS_OK")[:-1]
"""Of kcg.gateway, in its order."""
