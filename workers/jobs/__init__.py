"""The job store: the only truth about jobs and their segments. Imports neither Ray nor PyTorch nor the web."""
