"""An actor with the fixed name ``twin``: ``twin.py ENDPOINT PARENT_PID``."""

import sys
import threading

from udrl_actor.actor_service import ActorService
from udrl_launch.process import die_with_parent
from udrl_proto.session import connect, find_run
from udrl_proto.zenoh_transport import ZenohTransport

if __name__ == "__main__":
    die_with_parent(int(sys.argv[2]))
    with connect(sys.argv[1], 10.0) as session:
        hello = find_run(session, None, 10.0)
        ActorService(ZenohTransport(session), hello, "twin", 4, threading.Event()).run()
