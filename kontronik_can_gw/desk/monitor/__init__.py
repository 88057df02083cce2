"""The live screen's model, that CAN frames go into."""
