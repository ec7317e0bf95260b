"""What is compared: TP-GMM, learned baselines, and replay."""
