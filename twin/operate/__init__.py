"""An instrument in operation: its record, its estimated state, alarms, reports and products, and simulated lives."""
