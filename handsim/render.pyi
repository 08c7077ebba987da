from render import *
