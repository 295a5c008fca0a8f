"""`clothbus report`: a run as one HTML page.

`sources` says where a run's record is read, `gather` folds it into numbers and a few episodes,
`figures` and `pictures` draw them, `page` writes the page. Nothing here plays or learns.
"""
