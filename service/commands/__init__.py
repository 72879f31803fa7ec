"""Commands that talk to the service, or start it. `service.cli` gives them their names."""
