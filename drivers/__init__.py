"""The ports to hardware: stage (PI), pump (KD Scientific), DAQ (NI), and the sensors' volts to SI."""
