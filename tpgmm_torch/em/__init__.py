"""Expectation-maximisation for mixtures with block-diagonal covariances."""
