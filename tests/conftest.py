"""What holds for all tests: the same examples in every run, and one thread per worker."""

import torch
from hypothesis import settings

settings.register_profile("reproducible", deadline=None, derandomize=True)
settings.load_profile("reproducible")

torch.set_num_threads(1)
