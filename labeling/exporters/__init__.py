"""One file a format, each behind the Exporter protocol of exporter.py."""
