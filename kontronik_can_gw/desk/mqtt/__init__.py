"""The MQTT publisher: topics, payloads, Home Assistant's discovery, a client that reconnects."""
