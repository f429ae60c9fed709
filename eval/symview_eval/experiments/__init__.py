"""The command `symview-experiment`: reruns the paper's tables and figures at a chosen scale."""
