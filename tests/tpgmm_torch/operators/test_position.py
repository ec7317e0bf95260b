"""Position operators against eqs (4) and (6)."""

from tests.support import oracles
from tests.support.operator_battery import OperatorLaws, laws_in_places
from tpgmm_torch import AbsolutePosition, RelativePosition

KINDS = AbsolutePosition, RelativePosition
ROWS = oracles.absolute_position, oracles.relative_position
globals().update(laws_in_places(KINDS, ROWS, OperatorLaws))
