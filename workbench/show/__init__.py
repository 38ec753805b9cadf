"""Results as people see them: charts, pictures, tables, the report."""
