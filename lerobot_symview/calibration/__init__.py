"""Camera calibration from files, for datasets and robots that do not store it."""
