"""From a preprocessed observation to a network's input."""
