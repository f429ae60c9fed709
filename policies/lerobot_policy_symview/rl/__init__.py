"""Reinforcement learning of `symview_sacfd`: replay buffer, learner, rollouts, and the command `symview-train-rl`."""
