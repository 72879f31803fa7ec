"""How many threads a process of ours computes with: one."""

import scipy.linalg  # noqa: F401 - brings a thread pool of its own, which only a loaded library can be limited in
import threadpoolctl
import torch


def use_one_thread() -> None:
    """Keep this process to one core: small batches run many times slower on more threads (benchmarks/README.md).

    Every process that labels calls this: the number of threads changes the rounding, and so the bytes of labels.
    """
    torch.set_num_threads(1)
    threadpoolctl.threadpool_limits(1)
