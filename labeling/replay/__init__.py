"""One page a segment that shows points, boxes and tracks over time, and needs nothing but a browser."""
