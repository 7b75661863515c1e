"""What a picture will show, estimated on the host in a fraction of a second: where it is lit, and how strongly."""
