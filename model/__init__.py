"""The science: the network, its training, the sensor simulator, the traditional pipeline and the metrics."""
