"""Networks: equivariant layers, encoders, heads and the critic."""
