"""The paper's experiment (section IV) and its figures: what ``tpgmm demo`` runs."""
