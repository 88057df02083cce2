"""The MQTT publisher: topics and messages, and a client that reconnects by itself."""
