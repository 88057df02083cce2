"""What a gateway sends and what it means: ``tables`` of the DBC and EDS in use, values, errors and states; ``markdown`` renders them."""
