"""Models on the Hugging Face hub, and the card that describes one."""

from tpgmm_torch.hub.model_card import describe, model_card
from tpgmm_torch.hub.repository import download, upload

__all__ = ["describe", "download", "model_card", "upload"]
