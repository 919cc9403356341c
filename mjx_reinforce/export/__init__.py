"""Export: trained policies as files."""
