"""The charts of the report's page, a file each; ``draw`` yields a chart, or none without rows."""
