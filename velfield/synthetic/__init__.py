"""A city, its traffic and its camera, with the truth.

>>> from velfield.synthetic.cases import small_flight
>>> flight = small_flight(frames=2, width=320, height=240)
>>> flight.frame(0).shape
(240, 320)
"""
