"""What TP-GMM is compared with: learned baselines, and replay."""
