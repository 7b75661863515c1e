"""Why a pixel is what it is: its error budget, and its ray."""
