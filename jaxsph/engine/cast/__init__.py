"""Along rays: from the optics of media at samples to colour and transmittance, and back for gradients."""
