"""Gaussian mixtures over blocks of columns, learned by expectation-maximisation."""
