"""The command `symview-calibrate`: a camera's calibration from images of a board, or from other tools' files."""
