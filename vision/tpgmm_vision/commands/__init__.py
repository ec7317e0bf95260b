"""Commands that ``tpgmm`` finds by entry points."""
