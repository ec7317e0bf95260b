"""When things happen in demonstrations: grippers close, objects move, links stop."""

from tpgmm_torch.events.detection import (
    LEAST_CONFIDENCE,
    Detection,
    Detector,
    find_events,
)
from tpgmm_torch.events.movement import ObjectMoves, Stop
from tpgmm_torch.events.signals import SignalEvent
from tpgmm_torch.events.text import parse_event

__all__ = [
    "LEAST_CONFIDENCE",
    "Detection",
    "Detector",
    "ObjectMoves",
    "SignalEvent",
    "Stop",
    "find_events",
    "parse_event",
]
