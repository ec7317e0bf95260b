"""Policies that TP-GMM is compared with: learned baselines, and replay."""
