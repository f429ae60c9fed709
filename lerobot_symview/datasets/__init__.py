"""LeRobot datasets on disk: reading them, and writing them again with views as new camera keys."""
