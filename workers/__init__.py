"""Where it runs: the job store, the dispatcher and the Ray workers."""

import os

# Before Ray is imported: it reads these once. No report to Ray's makers; and a task that ran out of memory comes back
# to us, who count attempts, instead of being repeated in secret.
os.environ.setdefault("RAY_USAGE_STATS_ENABLED", "0")
os.environ.setdefault("RAY_task_oom_retries", "0")
