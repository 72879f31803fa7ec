"""One script a version, in files named by their number. None reads ``workers.jobs.tables``, which goes on changing."""
