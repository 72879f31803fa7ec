"""Settings all tests share."""

from hypothesis import settings

settings.register_profile("motionlabel", deadline=None)  # a busy machine must not fail a test
settings.load_profile("motionlabel")
