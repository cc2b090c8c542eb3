"""What objectives, minimisers and observers of long work agree on."""

__all__: list[str] = []
