"""The paper's tables and figures, rerun at a stated scale."""
