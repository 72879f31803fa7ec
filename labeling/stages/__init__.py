"""The method, one file a stage; labeling/line.py runs them in order."""
