"""Skills of two hands that differ in what matters: a path, a force, a hole, another hand."""
