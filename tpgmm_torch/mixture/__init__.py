"""The mixture over blocks of columns, as a scikit-learn estimator."""
