"""Commands that show, measure and reproduce: preview, demo, doctor, benchmarks and experiments."""
