"""Rigid transforms, boxes, voxels and nearest neighbours: the geometry all stages share."""
