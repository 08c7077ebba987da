from gloves import *
