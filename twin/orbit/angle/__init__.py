"""The intersection-angle test: what is flown and measured, the procedure, JSON, report (paper 000)."""
