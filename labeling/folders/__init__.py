"""The label folder: publishing its files whole and once, naming them, reading them back."""
