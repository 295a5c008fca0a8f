"""One thread, as the learner's processes have: results are repeatable, and small steps fast."""

import torch

torch.set_num_threads(1)
