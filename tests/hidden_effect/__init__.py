"""Hide an effect in data, and require that it be found."""
