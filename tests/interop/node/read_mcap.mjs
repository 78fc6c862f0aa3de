// Decode every message of an MCAP file with the descriptors embedded in it; one JSON document on stdout.
import { open } from "node:fs/promises";
import { McapIndexedReader } from "@mcap/core";
import { FileHandleReadable } from "@mcap/nodejs";
import { loadDecompressHandlers, protobufFromBinaryDescriptor } from "@mcap/support";

const handle = await open(process.argv[2], "r");
const reader = await McapIndexedReader.Initialize({
  readable: new FileHandleReadable(handle),
  decompressHandlers: await loadDecompressHandlers(),
});

const decoders = new Map();
for (const [id, channel] of reader.channelsById) {
  const schema = reader.schemasById.get(channel.schemaId);
  decoders.set(id, { channel, schema, type: protobufFromBinaryDescriptor(schema.data).lookupType(schema.name) });
}

const topics = {};
for await (const message of reader.readMessages()) {
  const { channel, schema, type } = decoders.get(message.channelId);
  const value = type.decode(message.data);
  const topic = (topics[channel.topic] ??= {
    schema: schema.name, encoding: schema.encoding, count: 0, positions: [], bytes: [], times: [],
  });
  topic.count += 1;
  topic.times.push(Number(message.logTime));
  if (value.pose) topic.positions.push([value.pose.position.x, value.pose.position.y, value.pose.position.z]);
  if (value.poses) topic.poses = value.poses.length;
  if (value.transforms) topic.positions.push(...value.transforms.map(({ translation: t }) => [t.x, t.y, t.z]));
  if (value.data) topic.bytes.push(value.data.length);
  if (value.K) topic.K = Array.from(value.K);
  if (value.frame_id) topic.frame = value.frame_id;
}

const metadata = {};
for await (const record of reader.readMetadata()) metadata[record.name] = Object.fromEntries(record.metadata);
await handle.close();
process.stdout.write(JSON.stringify({ library: reader.header["library"], topics, metadata }));
