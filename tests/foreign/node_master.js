'use strict';
/* A CANopen master around the npm package "canopen", driven by a test through lines of JSON.

   node node_master.js PACKAGES INTERFACE
     PACKAGES   the folder with node_modules/canopen and node_modules/socketcan

   In:   {"call": NAME, ...}   one of the functions in `calls`; calls are done one after the other
   Out:  {"result": ...} or {"error": TEXT, "code": ABORT CODE or LSS error}   for each call, in their order
         {"event": "heartbeat" | "emergency", ...}
   Bytes are hexadecimal texts. Ends with its input. */

const path = require('path');
const readline = require('readline');

const [packages, networkInterface] = process.argv.slice(2);
const load = (name) => require(path.join(packages, 'node_modules', name));
const { Device, Eds, LssMode } = load('canopen');

const MASTER = 0x7c;
const ANSWER_TIMEOUT = 60000; // every call is answered, however slow the machine is
const tell = (message) => process.stdout.write(JSON.stringify(message) + '\n');

const channel = load('socketcan').createRawChannel(networkInterface, true);
const master = new Device({ id: MASTER });
channel.addListener('onMessage', (m) => { if (!m.ext && !m.rtr && !m.err) master.receive(m); });
master.addListener('message', (m) => channel.send({ id: m.id, data: m.data, ext: false, rtr: false }));
channel.start();
master.start();
master.lss.start();
master.nmt.on('heartbeat', ({ deviceId, state }) => tell({ event: 'heartbeat', node: deviceId, state }));
master.emcy.on('emergency', ({ cobId, em }) => tell({
    event: 'emergency', cob_id: cobId, code: em.code, register: em.register, info: Buffer.from(em.info).toString('hex'),
}));

const address = ({ node, index, sub = 0, block = false }) =>
    ({ deviceId: node, index, subIndex: sub, blockTransfer: block, timeout: ANSWER_TIMEOUT });
// [sub-index, variable]; the package's own subIndex is wrong from 10 on
const variables = (entry) => Array.from((entry.subNumber ? entry._subObjects : [entry]).entries()).filter(([, v]) => v);

const calls = {
    /** Take a node under control: its SDO server, its heartbeat, its emergencies. */
    add({ node }) {
        master.eds.addSdoClientParameter(node, 0x600 + node, 0x580 + node);
        master.eds.addHeartbeatConsumer(node, ANSWER_TIMEOUT);
        master.eds.addEmcyConsumer(0x80 + node);
    },
    /** All that the package reads in an EDS: [index, sub-index, name, data type, access type] of each variable. */
    eds({ file }) {
        return Array.from(Eds.fromFile(file).values()).flatMap((entry) => variables(entry).map(
            ([sub, v]) => [entry.index, sub, v.parameterName, v.dataType, v.accessType]));
    },
    async upload(request) {
        return (await master.sdo.upload(address(request))).toString('hex');
    },
    async download(request) {
        await master.sdo.download({ ...address(request), data: Buffer.from(request.data, 'hex') });
    },
    /** startNode, stopNode, enterPreOperational, resetNode, resetCommunication */
    nmt({ command, node }) {
        master.nmt[command](node);
    },
    /** With hints, or it learns each 1 of an identity from an answer that does not come in time. */
    fastscan(hints) {
        return master.lss.fastscan({ timeout: ANSWER_TIMEOUT, ...hints });
    },
    /** inquireVendorId ..., configureNodeId, storeConfiguration */
    lss({ command, args = [] }) {
        return master.lss[command](...args, ANSWER_TIMEOUT);
    },
    select(identity) {
        return master.lss.switchModeSelective({ ...identity, timeout: ANSWER_TIMEOUT }).then(() => null);
    },
    waiting() {
        master.lss.switchModeGlobal(LssMode.OPERATION);
    },
};

(async () => {
    tell({ event: 'ready' });
    for await (const line of readline.createInterface({ input: process.stdin })) {
        const { call, ...request } = JSON.parse(line);
        try {
            const result = await calls[call](request);
            tell({ result: result === undefined ? null : result });
        } catch (error) {
            tell({ error: String(error), code: error.code });
        }
    }
    process.exit(0);
})();
