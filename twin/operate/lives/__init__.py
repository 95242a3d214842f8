"""Simulated lives of an instrument in operation: drawn, rendered into a record, followed, held against their truth."""
