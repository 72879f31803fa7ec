"""Alembic's scripts: how the tables of one version become those of the next. What was released stays as it is."""
