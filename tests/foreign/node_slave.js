'use strict';
/* A CANopen slave of the npm package "canopen", for the conformance test.

   node node_slave.js PACKAGES INTERFACE NODE_ID EDS
     PACKAGES   the folder with node_modules/canopen and node_modules/socketcan

   Writes the EDS of the slave to the file EDS, prints "ready", and runs until its input ends. */

const path = require('path');

const [packages, networkInterface, nodeId, edsFile] = process.argv.slice(2);
const load = (name) => require(path.join(packages, 'node_modules', name));
const { Device, Eds, AccessType, DataType } = load('canopen');

const id = Number(nodeId);
const eds = new Eds({ productName: 'slave of the npm package', lssSupported: true, baudRates: [1000000] });
eds.setIdentity({ vendorId: 0x1234, productCode: 1, revisionNumber: 0x10000, serialNumber: 42 }, { saveDefault: true });
eds.setDeviceName('slave of the npm package', { saveDefault: true });
eds.setErrorHistoryLength(4);
eds.setHeartbeatProducerTime(1000, { accessType: AccessType.READ_WRITE, saveDefault: true });
eds.setSyncCobId(0x80, { saveDefault: true });
eds.setEmcyCobId(0x80 + id, { saveDefault: true });
eds.addHeartbeatConsumer(0x7d, 500);
eds.addSdoServerParameter(id, 0x580 + id, 0x600 + id);
const number = eds.addEntry(0x2000, {
    parameterName: 'Number', dataType: DataType.UNSIGNED32, accessType: AccessType.READ_WRITE,
    defaultValue: 1, pdoMapping: true,
});
eds.addTransmitPdo({ cobId: 0x180 + id, transmissionType: 1, dataObjects: [number] });
eds.save(edsFile);

const channel = load('socketcan').createRawChannel(networkInterface, true);
const device = new Device({ id, eds, enableLss: true });
channel.addListener('onMessage', (m) => {
    if (m.ext || m.rtr || m.err) return;
    try {
        device.receive(m);
    } catch (error) { // a download that is too short raises RangeError in the package
        console.error(String(error));
    }
});
device.addListener('message', (m) => channel.send({ id: m.id, data: m.data, ext: false, rtr: false }));
channel.start();
device.start();
console.log('ready');
process.stdin.resume();
process.stdin.on('end', () => process.exit(0));
