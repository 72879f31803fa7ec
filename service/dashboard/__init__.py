"""The dashboard: pages for people, on what the REST API tells programs."""
