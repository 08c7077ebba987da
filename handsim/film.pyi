from film import *
