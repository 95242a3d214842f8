"""An instrument in operation: database of readings, estimated state, alarms, reports, and simulated operation."""
