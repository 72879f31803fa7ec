"""Where labelled objects came from and where they go: what a model of motion learns from."""
