"""Gaussian mixture regression in joint space: from a mixture to one joint reference."""
