"""The method, one file a stage; pipeline.py runs them in order."""
