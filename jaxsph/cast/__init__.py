"""Along rays: from particles near a cell to colour and transmittance."""
