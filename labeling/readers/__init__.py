"""One file a data set, each behind the SegmentReader protocol of reader.py."""
