"""Edges between patches: where surfaces meet, where one ends, and the fillets that join them."""
