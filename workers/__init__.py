"""Where it runs: the job store, the dispatcher and the Ray workers."""
