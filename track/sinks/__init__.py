"""Live output: tracked frames go to other programs as they are made.

`message`: what is sent of a frame, and the protocol of what takes it.
`documents`: messages as JSON or MessagePack.
`osc_bundles`: messages as OSC.
`datagrams`: UDP: a document or an OSC bundle in each datagram.
`websocket`: a WebSocket server on this machine.
`lab_streaming`: a stream of the Lab Streaming Layer.
`addresses`: opens what addresses name, as one group of which none stops the tracker.
"""
