"""The report as a page: its words, charts and tables, and the HTML document."""
