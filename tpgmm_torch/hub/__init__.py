"""Models on the Hugging Face hub, and the card that describes one."""

from tpgmm_torch.hub.model_card import describe, model_card
from tpgmm_torch.hub.repository import download, load, push, upload

__all__ = ["describe", "download", "load", "model_card", "push", "upload"]
