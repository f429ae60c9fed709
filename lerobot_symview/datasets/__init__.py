"""LeRobot datasets on disk: reading them, and writing copies with views as new camera keys."""
