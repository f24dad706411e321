"""Routes of divided worlds: which zone owns a vehicle, and where the nodes of zones meet."""

from __future__ import annotations

from cavmarl.service import requests, responses
from cavmarl.service.auth import TheService
from cavmarl.service.error_names import problem
from cavmarl.service.route_common import Nodes, Readers, SessionId, make_router

ownership = make_router("/v1/sessions/{number}", "ownership")


@ownership.get("/transfers")
async def get_transfers(
    identity: Readers, service: TheService, number: SessionId
) -> responses.Ownership:
    """Owners of vehicles that have changed their zone, and vehicles that another has PREPARED."""
    session = service.broker.session(identity, number)
    owners = [
        responses.OwnerOfVehicle(
            world=int(world), episode=table.episode, vehicle=vehicle, zone=zone, epoch=epoch
        )
        for world, table in session.owners.items()
        for vehicle, (zone, epoch) in table.zones.items()
    ]
    in_flight = [
        responses.InFlight(
            world=world, vehicle=vehicle, source=source, target=target, state="PREPARED"
        )
        for world, vehicle, source, target in service.broker.prepared.get(number, ())
    ]
    return responses.Ownership(number=session.told_number, owners=owners, in_flight=in_flight)


@ownership.put("/transfers", status_code=204)
async def put_transfers(
    identity: Nodes, service: TheService, number: SessionId, body: requests.TransfersBody
) -> None:
    """A node tells which vehicles have changed their zone since it told last."""
    service.broker.hand_over(service.broker.hosted(identity, number), body)


@ownership.put("/door", status_code=204)
async def put_door(
    identity: Nodes, service: TheService, number: SessionId, body: requests.DoorBody
) -> None:
    """Where the node of a session awaits those that host zones of it."""
    session = service.broker.hosted(identity, number)
    node = service.broker.log.state.nodes[session.node or ""]
    if body.host != node.address:  # others are sent there: nowhere but to the node itself
        raise problem("refused", f"host: is '{body.host}', the node's address '{node.address}'")
    service.broker.zone_nodes.open_door(session, body)
