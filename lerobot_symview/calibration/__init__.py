"""Reading what is known of cameras that datasets and observations do not describe themselves."""
