"""The made-up world: its lidar, its shapes, its traffic. What it shows is known exactly."""
