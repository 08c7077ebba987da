from poses import *
