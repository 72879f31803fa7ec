"""Who may ask: the command line (and the HTTP API). Never imports ray or torch at module level."""
