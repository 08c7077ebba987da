from track import *
