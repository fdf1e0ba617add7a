"""A second, independent simulator of orbital images of the Moon, made to judge a diagnosis of image errors.

Lengths are in map pixels unless a name says otherwise; angles carry their unit in the name.
Rows run to the south and columns to the east; azimuths are clockwise from north.
"""
