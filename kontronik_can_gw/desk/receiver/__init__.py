"""The receiver of the frames: listens to a bus, and decodes what it hears."""
