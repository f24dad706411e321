"""Routes of divided worlds: owners of vehicles, and connections of the nodes of a session."""

from __future__ import annotations

from cavmarl.service import request_bodies, response_bodies
from cavmarl.service.error_names import problem
from cavmarl.service.route_access import TheService
from cavmarl.service.route_common import Nodes, Readers, SessionId, make_router

ownership = make_router("/v1/sessions/{number}", "ownership")


@ownership.get("/transfers")
async def get_transfers(
    identity: Readers, service: TheService, number: SessionId
) -> response_bodies.Ownership:
    """Return the owners of transferred vehicles, and the vehicles with a prepared transfer."""
    session = service.broker.session(identity, number)
    owners = [
        response_bodies.OwnerOfVehicle(
            world=int(world), episode=table.episode, vehicle=vehicle, zone=zone, epoch=epoch
        )
        for world, table in session.owners.items()
        for vehicle, (zone, epoch) in table.zones.items()
    ]
    in_flight = [
        response_bodies.InFlight(
            world=world, vehicle=vehicle, source=source, target=target, state="PREPARED"
        )
        for world, vehicle, source, target in service.broker.prepared.get(number, ())
    ]
    return response_bodies.Ownership(number=session.told_number, owners=owners, in_flight=in_flight)


@ownership.put("/transfers", status_code=204)
async def put_transfers(
    identity: Nodes, service: TheService, number: SessionId, body: request_bodies.TransfersBody
) -> None:
    """Record the vehicles that have changed zone since the node's last report."""
    service.broker.hand_over(service.broker.hosted(identity, number), body)


@ownership.put("/door", status_code=204)
async def put_door(
    identity: Nodes, service: TheService, number: SessionId, body: request_bodies.DoorBody
) -> None:
    """Record where the node of a session waits for the nodes that host its zones."""
    session = service.broker.hosted(identity, number)
    node = service.broker.log.state.nodes[session.node or ""]
    if (
        body.host != node.address
    ):  # other nodes connect there, so it must be the address of the node itself
        raise problem(
            "refused", f"host: is '{body.host}', but must be the node's address '{node.address}'"
        )
    service.broker.zone_nodes.open_door(session, body)
