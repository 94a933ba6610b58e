/* CANopenNode's demo device; its bus and its time are a pipe.
 *
 * In: 'F' u32 identifier (bit 11: remote request) u8 DLC 8 bytes, or 'T' u32 microseconds that have passed.
 * Out: 'f' u32 identifier u8 DLC 8 bytes for each frame that it sends because of it, then 'E'. */
#include "CANopen.h"
#include "CO_identificators.h"
#include "OD.h"
#include "domainDemo.h"
#include "objectAccessOD.h"

static CO_t* CO;
static uint8_t pendingNodeId;
static uint16_t pendingBitRate = 1000;
static objectAccessOD_t objectAccess;
static uint8_t poweredOn[sizeof(OD_PERSIST_COMM)];

void CO_CANsetConfigurationMode(void* p) { (void)p; }
void CO_CANsetNormalMode(CO_CANmodule_t* module) { module->CANnormal = true; }
void CO_CANmodule_disable(CO_CANmodule_t* module) { (void)module; }
void CO_CANmodule_process(CO_CANmodule_t* module) { (void)module; }
void CO_CANclearPendingSyncPDOs(CO_CANmodule_t* module) { (void)module; }

CO_ReturnError_t CO_CANmodule_init(CO_CANmodule_t* module, void* p, CO_CANrx_t rx[], uint16_t rxSize, CO_CANtx_t tx[],
                                   uint16_t txSize, uint16_t rate) {
    (void)rate;
    memset(module, 0, sizeof *module);
    module->CANptr = p;
    module->rxArray = rx, module->rxSize = rxSize;
    module->txArray = tx, module->txSize = txSize;
    for (int i = 0; i < rxSize; i++) rx[i] = (CO_CANrx_t){.mask = 0xFFFF};
    for (int i = 0; i < txSize; i++) tx[i].bufferFull = false;
    return CO_ERROR_NO;
}

CO_ReturnError_t CO_CANrxBufferInit(CO_CANmodule_t* module, uint16_t index, uint16_t ident, uint16_t mask, bool_t rtr,
                                    void* object, void (*callback)(void* object, void* message)) {
    if (!module || !object || !callback || index >= module->rxSize) return CO_ERROR_ILLEGAL_ARGUMENT;
    module->rxArray[index] =
        (CO_CANrx_t){(ident & 0x7FF) | (rtr ? 0x800 : 0), (mask & 0x7FF) | 0x800, object, callback};
    return CO_ERROR_NO;
}

CO_CANtx_t* CO_CANtxBufferInit(CO_CANmodule_t* module, uint16_t index, uint16_t ident, bool_t rtr, uint8_t length,
                               bool_t sync) {
    (void)rtr;
    if (!module || index >= module->txSize) return NULL;
    CO_CANtx_t* buffer = &module->txArray[index];
    buffer->ident = ident & 0x7FF, buffer->DLC = length, buffer->bufferFull = false, buffer->syncFlag = sync;
    return buffer;
}

CO_ReturnError_t CO_CANsend(CO_CANmodule_t* module, CO_CANtx_t* buffer) {
    (void)module;
    putchar('f');
    fwrite(&buffer->ident, 4, 1, stdout);
    putchar(buffer->DLC);
    fwrite(buffer->data, 8, 1, stdout);
    return CO_ERROR_NO;
}

static void resetCommunication(void) {
    uint32_t info = 0;
    memcpy(&OD_PERSIST_COMM, poweredOn, sizeof poweredOn); /* as the storage of a target does */
    OD_PERSIST_COMM_t* od = &OD_PERSIST_COMM;
    CO_LSS_address_t address = {.identity = {od->x1018_identity.vendor_ID, od->x1018_identity.productCode,
                                             od->x1018_identity.revisionNumber, od->x1018_identity.serialNumber}};
    if (CO_CANinit(CO, (void*)1, pendingBitRate) || CO_LSSinit(CO, &address, &pendingNodeId, &pendingBitRate)) exit(3);
    uint16_t control = CO_NMT_ERR_ON_ERR_REG | CO_NMT_ERR_ON_BUSOFF_HB | CO_ERR_REG_GENERIC_ERR | CO_ERR_REG_COMMUNICATION;
    if (CO_CANopenInit(CO, NULL, NULL, OD, NULL, control, 10, 1000, 500, false, pendingNodeId, &info)) exit(4);
    if (CO_CANopenInitPDO(CO, CO->em, OD, pendingNodeId, &info)) exit(5);
    CO_CANsetNormalMode(CO->CANmodule);
}

static void process(uint32_t us) {
    CO_NMT_reset_cmd_t reset = CO_process(CO, false, us, NULL);
    bool_t sync = CO_process_SYNC(CO, us, NULL);
    CO_process_RPDO(CO, sync, us, NULL);
    CO_process_TPDO(CO, sync, us, NULL);
    if (reset != CO_RESET_NOT) resetCommunication();
}

int main(int count, char** arguments) {
    uint32_t heap = 0, info = 0, word;
    uint8_t nodeId = pendingNodeId = count > 1 ? atoi(arguments[1]) : 5;
    if (!(CO = CO_new(NULL, &heap))) return 2;
    CO_identificators_init(&pendingBitRate, &nodeId);
    objectAccessOD_init(&objectAccess, OD_ENTRY_H2120_demoRecord, &info);
    domainDemo_init(OD_ENTRY_H2122_demoDomain, &info);
    memcpy(poweredOn, &OD_PERSIST_COMM, sizeof poweredOn);
    resetCommunication();
    for (int kind; (kind = getchar()) != EOF && fread(&word, 4, 1, stdin) == 1;) {
        if (kind == 'F') {
            CO_CANrxMsg_t message = {.ident = word, .DLC = getchar()};
            if (fread(message.data, 8, 1, stdin) != 1) break;
            for (int i = 0; i < CO->CANmodule->rxSize; i++) {
                CO_CANrx_t* buffer = &CO->CANmodule->rxArray[i];
                if (buffer->CANrx_callback && !((message.ident ^ buffer->ident) & buffer->mask)) {
                    buffer->CANrx_callback(buffer->object, &message);
                    break;
                }
            }
            word = 0;
        }
        for (int i = 0; i < 3; i++) process(i ? 0 : word); /* what one part leaves for the next is done at once */
        putchar('E');
        fflush(stdout);
    }
    return 0;
}
