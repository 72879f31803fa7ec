"""What we do to the data: readers, stages, evaluation, pictures. No Ray, no web, no database."""
